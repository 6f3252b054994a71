"""What is measured on decoded frames."""
