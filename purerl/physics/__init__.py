"""MuJoCo behind one small stateless interface: one simulation, whatever the engine.

A new engine belongs here. May import: core, exact.
Read: interface, then the engine you use (engine_c, engine_mjx, engine_warp). `lookup` finds bodies,
joints and sensors by name; `drawing` says how a state looks.
"""
