"""The capture detector: from poses and buffer state to a verdict."""
