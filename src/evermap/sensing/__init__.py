"""What a sensor should see: probability of detection."""
