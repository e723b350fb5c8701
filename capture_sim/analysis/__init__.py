"""Recorded runs examined again: measured, compared, resimulated, identified."""
