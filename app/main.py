"""What `panel serve app` runs, once per session."""

from wfsobs.app.dashboard import page
from wfsobs.app.work import one_blas_thread

one_blas_thread()
page().servable(title="wfsobs")
