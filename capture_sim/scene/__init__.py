"""What stands on the bench: parts, their quantities, and the files that hold them."""
