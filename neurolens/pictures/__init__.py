"""What a lens camera makes: renders, flare, blurred plates, shots."""
