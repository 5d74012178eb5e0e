"""What a lens is and does: its data, rays through it, files, analyses, photographs."""
