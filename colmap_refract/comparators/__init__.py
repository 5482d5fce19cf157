"""Methods that the paper compares with, and one it calls complementary, each as good as it can be made."""
