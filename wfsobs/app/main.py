"""What `panel serve app` runs, once per session."""

from wfsobs.app.serve import new_page, shared

new_page(shared()).servable(title="wfsobs")
