"""Error and speed: rays, vignetting, images, time, and the report that shows the trade."""
