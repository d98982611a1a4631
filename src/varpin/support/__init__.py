"""What every module may use: checks of arguments, frozen arrays, executors, tables, HTML."""
