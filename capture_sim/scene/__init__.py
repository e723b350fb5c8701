"""Scenes: the parts of a bench, their quantities, and the YAML files that describe them."""
