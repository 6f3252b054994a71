"""What plugin authors test with. Ships with the package."""
