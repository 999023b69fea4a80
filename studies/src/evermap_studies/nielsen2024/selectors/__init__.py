"""Which of its positions each landmark held at every look, given poses and positions (Nielsen and Hendeby 2024)."""
