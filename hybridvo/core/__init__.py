"""What every room reads: types, results, errors, options, geometry, files."""
