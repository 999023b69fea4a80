"""Sessions of recorded robots entered into one map while landmarks move, leave and come back."""
