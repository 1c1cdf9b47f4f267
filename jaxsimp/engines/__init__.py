"""The same plan in physics engines that we did not write."""
