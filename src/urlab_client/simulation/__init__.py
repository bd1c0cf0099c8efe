"""Stepping and drawing a compiled scene with MuJoCo alone, without sockets: for servers and for batches of copies.

`controllers` turn set-points into controls; `drawing` draws what a camera sees, as `appearance` says, in the thread of
`painting`; `cameras` describe a camera and its latency. `joint_recording` reads and writes the plugin's recordings.
"""
