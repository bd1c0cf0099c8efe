"""A play session: stepping, controllers, options, what replies report, recording and replay."""
