"""Studies of many runs, or of recorded ones: sweep, design, identification, comparison."""
