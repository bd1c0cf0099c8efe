"""What a client goes through, for whoever records or shows it: states, pictures, poses and contacts."""
