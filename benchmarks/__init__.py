"""Side by side with other libraries, in one run: ratios, which hold on any machine, against a committed baseline."""
