"""The official metrics and archives, labels that look wrong, and the paper's figures."""
