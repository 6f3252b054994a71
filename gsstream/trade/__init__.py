"""What a run costs and what it gives, measured and shown: one room for each question.

``measure`` reads what runs wrote, ``show`` draws it, ``jobs`` runs work on this machine or a cluster, ``sweep`` runs
many recipes on many scenes, ``report`` sets a sweep out, and ``bench`` times renderers and frame steps.
"""
