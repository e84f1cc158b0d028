"""What every room uses: checks, files, memory, precision, grids."""
