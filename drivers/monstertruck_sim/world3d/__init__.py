"""The engine ``mujoco``: rigid bodies, springs, tyres and uneven ground in three dimensions."""
