"""radarsdf."""
