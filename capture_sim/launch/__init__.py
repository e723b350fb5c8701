"""How the chaser is launched: the plan, and the watch that releases it."""
