"""What scatters: molecules, aerosols, their tables, and the line that they scatter."""
