"""Files: archives of results, scene files."""
