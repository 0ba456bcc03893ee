"""Where a camera could stand: free poses around a capture, clear of matter and within bounds."""
