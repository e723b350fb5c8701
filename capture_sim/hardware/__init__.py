"""Hardware in the loop: the loop through a contact rig, and such a rig in software."""
