"""A gallery of what real lenses do: each effect a small file, rendered and measured exact, as a surrogate and thin."""
