"""``tools/servo``: a visual servo of a simulated arm that carries the camera which a real monitor watches."""
