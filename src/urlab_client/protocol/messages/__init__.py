"""Request and reply structs, one module per namespace. `urlab_client.protocol.registry` lists the ops."""
