"""Transports for requests and published messages."""
