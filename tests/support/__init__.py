"""What several test modules use: synthetic flows and images, small experiments."""
