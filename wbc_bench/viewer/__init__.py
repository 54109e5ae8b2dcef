"""To look at episodes: live in a browser, replayed in a page of their own, or as a film."""
