"""Error against run time: scenes with known motions, integrated in every sensible way, as records, a table and a page."""

from jaxdyn.report.cases import Case as Case
from jaxdyn.report.cases import cases as cases
from jaxdyn.report.front import beaten_by as beaten_by
from jaxdyn.report.front import pareto_front as pareto_front
from jaxdyn.report.front import standings as standings
from jaxdyn.report.page import html_page as html_page
from jaxdyn.report.page import write as write
from jaxdyn.report.records import Record as Record
from jaxdyn.report.records import Report as Report
from jaxdyn.report.run import report as report
