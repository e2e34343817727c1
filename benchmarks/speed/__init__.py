"""How fast: a step, a recording, a live run, start-up."""
