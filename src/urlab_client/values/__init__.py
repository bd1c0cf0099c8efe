"""Values that the clients return, and their forms as plain data."""
