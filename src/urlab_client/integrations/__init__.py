"""Bridges to other libraries, each behind an optional extra and imported only when asked for."""
