"""The viewer: a local page that shows two clouds and how their features match."""
