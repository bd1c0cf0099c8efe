"""The groups of ops on the client: `client.scene`, `client.sim`, …"""
