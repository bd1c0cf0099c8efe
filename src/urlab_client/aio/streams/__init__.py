"""Published data: streams, what feeds them, and the state and pictures that arrive without a request."""
