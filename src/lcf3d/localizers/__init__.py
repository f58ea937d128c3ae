"""What puts a 3D box into a frustum."""
