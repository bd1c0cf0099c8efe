"""The states, pictures, poses and contacts of a client, for recordings and views."""
