"""What the page of a campaign does: it looks at the folder in a thread of the queue."""

from __future__ import annotations

from wfsobs.app.jobs.job import RUNNING, SWEEP, Job
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.campaign.follow import CampaignFolder, CampaignState
from wfsobs.settings.errors import SettingError


class CampaignTask(BackgroundTask):
    """A look at the folder of the server's campaign; the result stays the same object while nothing is new."""

    def look(self) -> None:
        """Read what is new, unless that is under way."""
        folder = self.folder
        if folder is not None and self.state != RUNNING:
            job = Job("campaign", lambda watch, _tell: folder.read(watch), priority=SWEEP, refusal=SettingError, quiet=True)
            self.start(job)

    @property
    def folder(self) -> CampaignFolder | None:
        """The campaign that the server was started with."""
        return self.session.service.campaign

    @property
    def campaign(self) -> CampaignState | None:
        """What is known by the last look."""
        return self.result
