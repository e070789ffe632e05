"""What in an image is not air, or not moved by it."""
