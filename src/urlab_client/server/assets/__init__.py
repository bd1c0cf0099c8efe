"""Files that clients name: blueprints, levels and models, and compiling them safely."""
