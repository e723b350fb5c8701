"""Measurements of speed and accuracy, each a program of its own; see the Makefile."""
