"""Output of runs and comparisons in notebooks: verdict, key figures, one picture.

Used by IPython through `_repr_html_` of `airl_mav.Run` and of the results of experiments.
Depends on: `airl_mav.report`.
"""

NOTEBOOK = {
    "run": "airl_mav.addons.notebook.notebook:run_html",
    "comparison": "airl_mav.addons.notebook.notebook:comparison_html",
}
