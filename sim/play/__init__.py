"""The simulator in the browser: a room to play in, and a live view of any session."""
