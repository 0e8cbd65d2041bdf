"""What `panel serve app` runs, once per session."""

from wfsobs.app.serve import new_page, shared_service

new_page(shared_service()).servable(title="wfsobs")
