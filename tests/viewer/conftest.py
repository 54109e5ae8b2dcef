from live_page import served  # noqa: F401  (a fixture)
