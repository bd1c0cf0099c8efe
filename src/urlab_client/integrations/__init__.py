"""Integrations with other libraries, each behind an optional extra and imported on demand."""
