"""Our identification behind the verbs of other libraries; each module needs the library that it is named after."""
