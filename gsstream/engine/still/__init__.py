"""What stands still in the pictures of a camera, and is remembered."""
