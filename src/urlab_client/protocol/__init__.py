"""The wire without I/O: ops, structs, codec, errors and binary layouts. Imports neither asyncio, zmq nor threads."""
