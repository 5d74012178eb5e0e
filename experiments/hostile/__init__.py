"""What do hostile input and kills do? Damaged files, wild numbers, commands killed at random."""
