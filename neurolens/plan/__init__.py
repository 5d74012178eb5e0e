"""What a scene asks for: effects of the lens that show in its picture, and the cheapest camera that keeps them."""
