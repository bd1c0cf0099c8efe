"""The session that viewers and agents share: state, controls, replay, recordings. It knows no web framework."""
