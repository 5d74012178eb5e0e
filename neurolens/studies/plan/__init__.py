"""What a scene needs: the effects of the lens that show in its picture, and the cheapest camera that has them."""
