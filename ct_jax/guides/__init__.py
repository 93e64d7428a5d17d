"""Planners that give waypoints: one file each. ``World.guide`` makes them."""
