"""The variational model: a smooth flow fitted to images as a whole, with its posterior."""
