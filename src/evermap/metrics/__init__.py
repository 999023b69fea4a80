"""How good an estimate is: poses, landmarks and consistency, against truth where there is any."""
