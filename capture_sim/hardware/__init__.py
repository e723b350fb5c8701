"""The seams for real hardware: the loop through a contact rig, and what sensors add."""
