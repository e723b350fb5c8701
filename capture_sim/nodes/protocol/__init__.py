"""How nodes agree on a run: the roll call, the announcement, the following."""
