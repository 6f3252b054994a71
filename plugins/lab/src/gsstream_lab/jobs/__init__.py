"""Jobs on workers: who runs them, in what order, and what the machine is that they run on."""
