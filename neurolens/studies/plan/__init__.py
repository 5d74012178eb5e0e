"""The needs of a scene: effects of the lens that show in its picture, and the cheapest camera that has them."""
