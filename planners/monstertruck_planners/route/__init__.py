"""Route planners: shortest motions of a car, searches over a map, smoothing. Modules that load numba run in workers."""
