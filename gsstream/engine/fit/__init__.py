"""What every optimisation shares: rows with their optimiser state, and how a view is compared."""
