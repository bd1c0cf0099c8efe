"""The client's knowledge of the simulation and the connection, and what is uncertain after a lost reply."""
