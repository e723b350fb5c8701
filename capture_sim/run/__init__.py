"""What is known of a run, simulated or measured."""
