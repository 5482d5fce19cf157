"""From a database of keypoints and matches to models: start values, tracks, and what refraction cost."""
