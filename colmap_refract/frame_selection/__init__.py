"""Which frames to take, and which as the reference: sharp, rich in features, and unlike each other."""
