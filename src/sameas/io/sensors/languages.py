"""Names of columns in other languages: Danish, Dutch, French, German, Italian, Norwegian, Portuguese, Spanish, Swedish.

Names are compared without accents, blanks and signs, as :func:`plain` writes them; German umlauts also as ae, oe, ue.
A name that means one quantity in all tables is in :data:`NAMES`. German, Dutch and the Scandinavian languages have one
word for latitude and width, and one for longitude and length: they are a position where both are in a table that has no
other one (:func:`names_in`). The word for time or track in one language that is another thing in English counts only
beside certain names of its language.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Set

_LETTERS = str.maketrans({"ø": "o", "æ": "ae", "ß": "ss", "œ": "oe", "ł": "l", "ð": "d"})


def plain(text: str) -> str:
    """The text in lower case without accents.

    >>> plain("Länge"), plain("Sjømil"), plain("Cap vérité"), plain("Größe")
    ('lange', 'sjomil', 'cap verite', 'grosse')
    """
    decomposed = unicodedata.normalize("NFD", text.lower().translate(_LETTERS))
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


#: Columns of Reports of which a report has one at least.
PLACES = {"lat_deg", "x_m", "range_m", "bearing_deg", "relative_bearing_deg"}
#: By column of Reports, names that are certain.
NAMES: Mapping[str, str] = {
    "time_s": (
        "zeit zeitstempel uhrzeit zeitpunkt datumzeit datumuhrzeit datumundzeit datumunduhrzeit "  # German
        "horodatage horodate dateheure dateetheure heure "
        "fechahora fechayhora fechahorautc marcadetiempo fecha hora "
        "dataora dataeora orario datahora dataehora "
        "tidspunkt tidsstempel datotid datoogtid klokkeslett klokkeslaet dato tidpunkt tidsstampel datumtid "
        "tijd tijdstip tijdstempel datumtijd"
    ),
    "lat_deg": "breitengrad geogrbreite geographischebreite latitud latitudine breddegrad breddgrad breedtegraad",
    "lon_deg": (
        "langengrad laengengrad geogrlange geogrlaenge geographischelange geographischelaenge longitud longitudine "
        "lengdegrad laengdegrad langdgrad lengtegraad"
    ),
    "alt_m": "hohe hoehe flughohe flughoehe altitud altura altezza quota hoyde hojde hojd hoogte",
    "range_m": "entfernung distanz abstand distancia distanza avstand afstand",
    "bearing_deg": (
        "peilung rwpeilung rechtweisendepeilung peilwinkel peilwert azimut acimut azimute relevement rilevamento "
        "peiling pejling baring"
    ),
    "relative_bearing_deg": "seitenpeilung gisement marcacionrelativa rilevamentopolare polarepeiling relativpeiling",
    "elevation_deg": "elevationswinkel elevacion elevazione elevacao",
    "speed_m_per_s": (
        "geschwindigkeit fahrt fahrtubergrund fahrtuebergrund geschwindigkeitubergrund geschwindigkeituebergrund fug "
        "vitesse vitessefond vitessesol velocidad velocidadsobreelfondo velocita velocitasulfondo velocidade "
        "velocidadesobreofundo hastighet hastighed fart snelheid"
    ),
    "course_deg": (
        "kurs kursubergrund kursuebergrund kug routefond routesol rumbosobreelfondo rottasulfondo rumosobreofundo "
        "rumbo rotta rumo kursovergrund koers"
    ),
    "heading_deg": "steuerkurs vorausrichtung rechtvorausrichtung prua styrtkurs stevning",
    "track_id": (
        "zielnummer zielnr zielid trackkennung spurnummer spurnr numeropiste numpiste idpiste numerocible numcible "
        "idcible numeroblanco idblanco numeropista idpista idbersaglio numeroalvo idalvo malnummer malnr "
        "sporingsnummer doelnummer doelnr"
    ),
    "callsign": "rufzeichen indicatif indicativo nominativo kallesignal kaldesignal anropssignal roepnaam",
    "name": (
        "schiffsname nomdunavire nomnavire nombrebuque nombredelbuque nombredebuque nomenave nomedellanave nomenavio "
        "nomedonavio skipsnavn fartoynavn skibsnavn fartygsnamn scheepsnaam"
    ),
    "type": "schiffstyp typenavire typedenavire tipobuque tipodebuque tiponave tiponavio skipstype skibstype "
            "fartygstyp scheepstype",
    "frequency_hz": "frequenz frequence frecuencia frequenza frequencia frekvens frequentie",
    "length_m": "schiffslange schiffslaenge longueur eslora lunghezza comprimento scheepslengte",
    "width_m": "schiffsbreite largeur manga larghezza boca",
}  # fmt: skip
#: Words for latitude and width, and for longitude and length.
_BREADTHS = (
    ("breite", "lange laenge"), ("bredde", "lengde laengde langde"), ("bredd", "langd"), ("breedte", "lengte"),
)  # fmt: skip
#: Those for latitude and width.
BREADTHS = frozenset(breadth for breadth, _ in _BREADTHS)
#: Words that are something else in English tables: column, word, and names of which one must be there too.
_IN_COMPANY = (
    ("time_s", "datum", "zeit uhrzeit breite breitengrad kurs geschwindigkeit peilung tijd koers snelheid tid fart"),
    ("time_s", "tid", "breddegrad bredde bredd kurs fart hastighet hastighed avstand afstand peiling pejling dato"),
    ("time_s", "tempo", "latitudine longitudine rotta velocita distanza velocidade rumo azimute"),
    ("time_s", "ora", "latitudine longitudine rotta velocita distanza data"),
    ("time_s", "temps", "vitesse cap route relevement azimut gisement"),
    ("time_s", "tiempo", ""),
    ("course_deg", "route", "vitesse heure horodatage cap relevement temps"),
    ("heading_deg", "cap", "vitesse heure horodatage route relevement temps"),
    ("heading_deg", "proa", "velocidad velocidade rumbo rumo hora"),
    ("track_id", "ziel", "zeit kurs peilung entfernung geschwindigkeit"),
    ("track_id", "spur", "zeit kurs peilung entfernung geschwindigkeit"),
    ("track_id", "cible", ""), ("track_id", "piste", "vitesse heure temps cap route"),
    ("track_id", "blanco", "hora tiempo rumbo velocidad"), ("track_id", "bersaglio", ""),
    ("track_id", "pista", "hora tiempo rumbo velocidad rotta velocita"), ("track_id", "alvo", ""),
    ("track_id", "mal", "tid kurs fart peiling avstand"), ("track_id", "doel", "tijd koers snelheid"),
    ("name", "nom", "vitesse heure cap route"), ("name", "nombre", "hora rumbo velocidad eslora"),
    ("name", "nome", "rotta velocita ora rumo velocidade hora"), ("name", "navn", "fart kurs tid hastighed hastighet"),
    ("name", "namn", ""), ("name", "naam", ""),
)  # fmt: skip
#: Columns of a date, and of the time of day beside it.
DATES = ("date", "datum", "fecha", "data", "dato")
HOURS = ("time", "zeit", "uhrzeit", "heure", "hora", "ora", "tid", "klokkeslett", "klokkeslaet", "tijd")


def names_in(stems: Set[str], known: Set[str]) -> dict[str, tuple[str, ...]]:
    """The names by column of Reports that are certain in a table.

    stems : of its columns, without units. known : columns of Reports that its English names give.

    >>> stems = {"breite", "lange"}
    >>> "breite" in names_in(stems, set())["lat_deg"], "breite" in names_in(stems, {"lat_deg"})["width_m"]
    (True, True)
    """
    names = {column: words.split() for column, words in NAMES.items()}
    has_place = not known.isdisjoint(PLACES | {"lon_deg"})
    has_place = has_place or not stems.isdisjoint(word for column in PLACES & names.keys() for word in names[column])
    for breadth, lengths in _BREADTHS:
        is_place = not has_place and breadth in stems and not stems.isdisjoint(lengths.split())
        names["lat_deg" if is_place else "width_m"].append(breadth)
        names["lon_deg" if is_place else "length_m"] += lengths.split()
    for column, word, company in _IN_COMPANY:
        if not company or not stems.isdisjoint(company.split()):
            names[column].append(word)
    return {column: tuple(words) for column, words in names.items()}
