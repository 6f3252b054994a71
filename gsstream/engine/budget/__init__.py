"""Budgets: what a frame may cost, how it is planned, held and reported."""
