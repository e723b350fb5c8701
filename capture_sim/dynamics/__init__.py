"""What moves, and when: the model, the solver, the engine, and the bench that runs it."""
