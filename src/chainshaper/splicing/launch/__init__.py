"""Launch files in their three languages: reading, following and editing copies of them."""
