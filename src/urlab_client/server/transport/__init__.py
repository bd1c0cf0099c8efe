"""The server's sockets and shared memory, and who may use them."""
