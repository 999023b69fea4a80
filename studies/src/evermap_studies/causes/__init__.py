"""What a recording contradicts has a cause: worlds with one cause each, and whether it is the one that is named."""
