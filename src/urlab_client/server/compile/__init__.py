"""From the actors of a level to one MuJoCo model."""
