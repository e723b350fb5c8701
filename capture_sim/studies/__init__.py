"""What many runs tell: capture envelope, capture margin, sensitivity."""
