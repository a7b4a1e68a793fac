"""The search of patent CN104359492A: orthogonal arrays, response surfaces, its criteria."""
