"""The official metrics, the paper's figures and drawings from above."""
