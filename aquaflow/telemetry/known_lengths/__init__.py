"""Objects of known size in the pictures: boards, laser dots, and lengths that a person marked."""
