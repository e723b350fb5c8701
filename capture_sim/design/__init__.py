"""The paper's design flow: wanted strokes in, buffer out, or why there is none."""
