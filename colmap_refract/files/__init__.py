"""What is on disk: COLMAP models, cameras and `refraction.json`, distrusted when read, written whole or not at all."""
