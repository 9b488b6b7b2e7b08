"""Routes: shortest motions of a car, searches over a map, shortening. Modules called compiled load numba: workers."""
