"""What every package uses: errors, files, hashes, seeds, array types."""
