"""Output of completions and evaluations: files, pages, tables, plots and videos."""
