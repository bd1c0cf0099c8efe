"""What the client knows of the simulation and the connection, and what is unknown after a lost reply."""
