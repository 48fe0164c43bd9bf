"""Pages of the documentation that are made from the code when the site is built."""


def cell(text: str) -> str:
    """Text in a table's cell."""
    return text.replace("|", "\\|").replace("<", "&lt;")
