"""AMVNet: LiDAR semantic segmentation by two views and late fusion."""
