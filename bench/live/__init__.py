"""Live maps: rates, accuracy, exact removal, memory."""
