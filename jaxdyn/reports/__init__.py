"""Error against run time of scenes by every sensible integrator, as records, a table and a page."""

from jaxdyn.reports.plotting import Record as Record
from jaxdyn.reports.plotting import Report as Report
from jaxdyn.reports.plotting import html_page as html_page
from jaxdyn.reports.plotting import pareto_front as pareto_front
from jaxdyn.reports.plotting import write as write
from jaxdyn.reports.programs import Case as Case
from jaxdyn.reports.programs import Reference as Reference
from jaxdyn.reports.run import report as report
