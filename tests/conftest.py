"""What holds for every test."""

from hypothesis import settings

# A test that is slow because the machine is busy has not failed; pytest's own limit ends those that hang.
settings.register_profile("urlab", deadline=None)
settings.load_profile("urlab")
