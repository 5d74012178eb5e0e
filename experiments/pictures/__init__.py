"""What does a picture take, and what does it look like? Plans, noise, blur, flare and the gallery."""
