"""Errors in the words of the page."""

_PAGE_WORDS = {
    "--min-radius": "Minimum radius",
    "--lrf-radius": "Frame radius",
    "--radius": "Support radius",
    "--voxel": "Voxel size",
    "--ratio": "Ratio",
    "--surest": "Surest",
    "--descriptor": "Descriptor",
    "--dim": "Dimensions",
    "--unit": "Unit",
    "--source-scale": "Source scale",
    "--model": "Model",
}


def in_words_of_the_page(text: str) -> str:
    """Errors name options of the command line; the page has controls instead."""
    for option, label in _PAGE_WORDS.items():
        text = text.replace(option, label)
    return text


def text_of(error: Exception) -> str:
    """What the page says of an error."""
    if isinstance(error, ValueError):
        return in_words_of_the_page(str(error))
    return f"{type(error).__name__}: {error}; start cgf-viewer with --debug to see where."
