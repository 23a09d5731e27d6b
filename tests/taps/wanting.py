"""A command's module that needs what the test says is not there."""

import a_library_that_nobody_has  # type: ignore[import-not-found]  # on purpose

main = a_library_that_nobody_has.main
