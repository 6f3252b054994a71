"""Reports of sweeps: Markdown and a page without a network, every number from the table."""
