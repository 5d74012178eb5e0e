"""What ships, and how right is it? Lens files, models, tables, and the pages of results."""
