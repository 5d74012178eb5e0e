"""How do other programs compare? Rays and pictures of ours beside theirs."""
